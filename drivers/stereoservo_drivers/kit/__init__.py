"""Building blocks of a custom joint driver: half-duplex buses, freshness, and the checks that it must pass."""
