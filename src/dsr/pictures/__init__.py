"""Drawing of scenes and depth maps: panels, grids, contact sheets, before and after; no page and no table."""
