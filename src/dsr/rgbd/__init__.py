"""``dsr upsample``: finer depth for people's own pairs of photo and depth map."""
