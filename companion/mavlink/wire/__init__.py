"""Bytes to frames to messages, and back: framing, checksums, one decoder per message."""
