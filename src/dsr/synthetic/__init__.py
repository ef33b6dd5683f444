"""Rendered scenes: ray casters, the SimGeo scenes, and random scenes to train on."""
