"""PPO of many members at once."""
