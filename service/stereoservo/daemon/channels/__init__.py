"""Lossless channels between processes that may die, hang or be restarted."""
