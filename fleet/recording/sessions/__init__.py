"""What `fleet sessions` does: list, look into, verify, recover, cut and export recordings."""
