"""Endless random scenes with exact depth, to train on.

Read :mod:`~dsr.synthetic.procedural.scenes` first; below it come the layouts, their props and furniture, the shapes and
paints, the ray tracer and the photo.
"""

from dsr.synthetic.procedural.scenes import PROCEDURAL_VERSION, render_random_scene

__all__ = ["PROCEDURAL_VERSION", "render_random_scene"]
