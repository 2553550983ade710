"""What a joint driver of one's own is made with: half-duplex buses, freshness, and the checks that it must pass."""
