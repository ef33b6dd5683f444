"""Plotting used by several packages: colour maps, panels, contact sheets, comparisons."""
