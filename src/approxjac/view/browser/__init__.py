"""A run in a web browser: one page with the arm in motion and its plots, on MeshCat."""
