"""Conversions between messages and internal types, in one package for all actors."""
