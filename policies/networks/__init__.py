"""What networks are made of, and the RLModules of PPO and DQN."""
