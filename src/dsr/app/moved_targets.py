"""What configurations of earlier runs say otherwise: paths of classes and functions that have moved, the logger."""

from __future__ import annotations

from typing import Any

MOVED_TARGETS = {
    "dsr.data.extras.NYU": "dsr.data.nyu.NYU",
    "dsr.data.extras.TartanAir": "dsr.data.tartanair.TartanAir",
    "dsr.data.procedural.source.Procedural": "dsr.data.procedural.Procedural",
    "dsr.data.training_sets.MiddleburyTrain": "dsr.data.middlebury.MiddleburyTrain",
    "dsr.data.training_sets.Sintel": "dsr.data.sintel.Sintel",
    "dsr.degrade.Downsampling": "dsr.degradation.downsampling.Downsampling",
    "dsr.degrade.Measured": "dsr.degradation.downsampling.Measured",
    "dsr.holes.Blobs": "dsr.degradation.holes.Blobs",
    "dsr.holes.Shadows": "dsr.degradation.holes.Shadows",
    "dsr.holes.no_holes": "dsr.degradation.holes.no_holes",
    "dsr.methods.dynamic_guidance.DynamicGuidance": "dsr.methods.networks.dg.DynamicGuidance",
    "dsr.methods.facets.Facets": "dsr.methods.networks.facets.Facets",
    "dsr.methods.msg_net.MSGNet": "dsr.methods.networks.msg_net.MSGNet",
    "dsr.methods.pdn.PrimalDualNetwork": "dsr.methods.networks.pdn.PrimalDualNetwork",
    "dsr.noise.GaussianMultiplicative": "dsr.degradation.noise.GaussianMultiplicative",
    "dsr.noise.Kinect": "dsr.degradation.noise.Kinect",
    "dsr.noise.TimeOfFlight": "dsr.degradation.noise.TimeOfFlight",
    "dsr.noise.no_noise": "dsr.degradation.noise.no_noise",
}
"""All targets that a training's configuration can name, from the old path to the current one."""


def update_logger(node: Any) -> Any:
    """Return loggers by name; earlier runs had one, with its name beside its settings."""
    if not isinstance(node, dict) or "name" not in node:
        return node
    return {str(node["name"]): {key: value for key, value in node.items() if key != "name"}}


def update_targets(node: Any) -> Any:
    """Return a configuration with the current path of each ``target`` that has moved."""
    if isinstance(node, dict):
        return {
            key: MOVED_TARGETS.get(value, value)
            if key == "target" and isinstance(value, str)
            else update_targets(value)
            for key, value in node.items()
        }
    return node
