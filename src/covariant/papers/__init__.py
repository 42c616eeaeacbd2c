"""Examples of the papers, reproduced with this library's observers, and the errata that matter."""
