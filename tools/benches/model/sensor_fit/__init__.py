"""Recordings with known artifacts, and how well `bodyseg sensor fit` finds their strengths."""
