"""Self-calibration from joint-wise trial motions (thesis 5.4)."""
