"""Train DQN for many members at once."""
