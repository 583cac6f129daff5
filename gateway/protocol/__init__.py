"""The car's wire protocol, pure: bytes to readings, commands to bytes, what each platform knows."""
