"""Built-in fluid simulations, for those who have no OpenVDB export at hand.

``scenes`` says what happens, ``solver`` how gas moves, ``generate`` writes a sequence of OpenVDB files.
"""
