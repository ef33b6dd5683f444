"""Plotting that several parts share: colour maps, panels, contact sheets, comparisons."""
