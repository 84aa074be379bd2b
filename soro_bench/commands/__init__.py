"""The commands of ``soro-bench``: what they take, and what they call. Nothing else imports them but cli.py."""
