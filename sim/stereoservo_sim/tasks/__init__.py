"""Campaigns of alignment tasks: task files, arms, controller models, closed-loop runs, many in parallel."""
