"""``dsr doctor``: checks of what is installed, and of scenes' depth maps and cameras, with advice."""
