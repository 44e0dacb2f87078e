"""Recordings: MCAP files of ROS 2 messages, written step by step, replayed bit for bit."""
