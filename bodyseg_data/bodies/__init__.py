"""Sources of bodies to render, behind one Protocol."""
