"""Launchers of sweeps for clusters; ``conf/hydra/launcher`` has their settings.

Unlike those of hydra-submitit-launcher and hydra-ray-launcher they wait for every job, also when one is killed or its
node is lost, and each job has a device of its own.
"""
