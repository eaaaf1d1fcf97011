"""Built-in fluid simulations of smoke and fire, written as OpenVDB files."""
