"""Cameras, surfaces and their renderings."""
