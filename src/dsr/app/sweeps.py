"""The callback of ``conf`` under the name that copies of earlier configuration files have."""

from dsr.app.entry import CheckJobs

__all__ = ["CheckJobs"]
