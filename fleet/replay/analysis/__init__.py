"""Compares a recording with today's code: its frames with the decoder, its readings with the policy."""
