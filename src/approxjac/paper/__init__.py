"""The paper's two-link study: Figures 1 and 3–8, from the URDF through Pinocchio."""
