"""A recorded session through today's decoder or policy, and where the result differs."""
