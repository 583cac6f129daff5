"""Control of one car, pure: what is sent when, and what is known; time comes in as an argument."""
