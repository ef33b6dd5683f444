"""The command behind ``dsr upsample``."""
