"""The place of :func:`dsr.metrics.losses.make_visual_loss` that configurations of trainings name."""

from dsr.metrics.losses import make_visual_loss

__all__ = ["make_visual_loss"]
