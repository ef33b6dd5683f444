"""Random scenes with exact depth, to train on: layouts, props, shapes, materials, a ray tracer and a camera."""
