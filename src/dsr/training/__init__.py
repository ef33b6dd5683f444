"""Training: patches of scenes, losses, the LightningModule."""
