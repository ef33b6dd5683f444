"""Files of users: photos, depth maps, cameras and meshes, and which of them belong together."""
