"""Forms of settings and their controls."""
