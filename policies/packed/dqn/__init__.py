"""DQN of many members at once."""
