"""SimGeo: the paper's geometric scenes, and a statue."""
