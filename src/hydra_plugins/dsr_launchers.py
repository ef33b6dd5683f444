"""Where Hydra looks for launchers: those of :mod:`dsr.app.launchers`."""

from dsr.app.launchers import ray_cluster, slurm


class SlurmLauncher(slurm.SlurmLauncher):
    """See ``conf/hydra/launcher/slurm.yaml``."""


class RayLauncher(ray_cluster.RayLauncher):
    """See ``conf/hydra/launcher/ray.yaml``."""
