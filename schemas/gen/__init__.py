"""Generated from schemas/proto; do not edit (`make proto`)."""
