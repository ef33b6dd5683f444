"""``dsr doctor``: checks of the depth maps and cameras of scenes, with advice on how to correct them."""
