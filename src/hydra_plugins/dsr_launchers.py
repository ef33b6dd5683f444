"""Where Hydra looks for launchers: that of :mod:`dsr.app.slurm`."""

from dsr.app import slurm


class SlurmLauncher(slurm.SlurmLauncher):
    """See ``conf/hydra/launcher/slurm.yaml``."""
