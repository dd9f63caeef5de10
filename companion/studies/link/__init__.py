"""The radio link bit by bit: code, modulation, OFDM, and beams that point as predicted."""
