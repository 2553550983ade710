"""Campaigns of alignment tasks: task files, arms, controller knowledge, closed-loop runs, many in parallel."""
