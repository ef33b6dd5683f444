"""Getting data sets: what there is, resumable downloads, checksums, archives."""
