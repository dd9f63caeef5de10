"""Bit-level simulation of the radio link: code, modulation, OFDM and pointing errors of beams."""
