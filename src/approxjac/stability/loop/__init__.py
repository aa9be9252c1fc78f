"""The closed loop: its terms at sampled configurations, and its linearisation."""
