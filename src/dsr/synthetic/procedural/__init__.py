"""Any number of random scenes with exact depth, to train on.

:mod:`~dsr.synthetic.procedural.random_scene` renders a scene. It uses the layouts with their props and furniture, the
shapes and materials, the ray tracer and the camera model.
"""

from dsr.synthetic.procedural.random_scene import PROCEDURAL_VERSION, render_random_scene

__all__ = ["PROCEDURAL_VERSION", "render_random_scene"]
