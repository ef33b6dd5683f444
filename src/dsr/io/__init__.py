"""People's files: photos, depth maps, cameras, meshes, and how they belong together."""
