"""The contract between all processes: messages, keys, topics, and the bus."""
