"""Train PPO for many members at once."""
