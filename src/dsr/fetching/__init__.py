"""Getting data sets: what there is, downloads that go on where they stopped, checksums, archives."""
