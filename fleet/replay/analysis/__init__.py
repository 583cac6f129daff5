"""Checks a recording with today's code: decodes its raw frames again, and runs the policy on its readings again."""
