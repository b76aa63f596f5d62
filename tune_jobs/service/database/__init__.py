"""What the service remembers that no sweep folder can hold: the queue, owners, tokens and the audit log."""
