"""The stability report: its tests, their outcome, and how it is rendered."""
