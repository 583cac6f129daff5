"""Sessions on disk: MCAP segments and what belongs to them."""
