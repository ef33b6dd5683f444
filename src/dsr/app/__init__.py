"""Configuration and commands: the only part that knows Hydra."""
