"""Conversions between messages and internal types, kept in one package."""
