"""Campaigns of alignment tasks: task files, arms, what is known of them, one task in closed loop, many in parallel."""
