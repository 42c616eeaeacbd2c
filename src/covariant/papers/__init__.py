"""Reproduces examples of the papers with this library's observers, and lists the papers' relevant errata."""
