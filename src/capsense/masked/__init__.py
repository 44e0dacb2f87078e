"""The scheme of Schöffmann et al. 2022: masked tetrahedra, solved in full at every step."""
