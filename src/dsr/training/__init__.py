"""Training of networks: augmentation, patches, the loss, the LightningDataModule and the LightningModule."""
