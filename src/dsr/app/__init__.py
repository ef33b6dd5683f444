"""Configuration and commands: the only subpackage that uses Hydra."""
