"""What the fleet should do, pure: plans, and what follows from readings."""
