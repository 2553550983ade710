"""What is on an arm's CAN bus beside its joints: digital outputs of its drives, grippers on drives of their own."""
