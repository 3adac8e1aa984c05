"""Adapters for training frameworks. Each imports its framework only where it is used."""
