"""PPO training and policies (needs the ``train`` extra)."""
