"""Emulated drives: what a rack of servo drives on a CAN bus does, frame by frame."""
