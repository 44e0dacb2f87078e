"""CapSense: real-time simulation of capacitive proximity sensors for robots."""
