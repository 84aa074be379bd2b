"""Paired recordings: the same commands before and after a change; what differs, and which change explains it."""
