"""The papers' own examples, reproduced with the library's observers, and the errata that matter."""
