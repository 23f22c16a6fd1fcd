"""Conversions between messages and numerics: the only package that knows both."""
