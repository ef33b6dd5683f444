"""Cameras, surface normals, shading and meshes."""
