"""Readable references in numpy that the product is tested against; nothing of the product imports them."""
