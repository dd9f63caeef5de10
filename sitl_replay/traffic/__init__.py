"""Sends scenarios and logs as live traffic, and records what is heard.                   [shell]"""
