"""Bundle adjustment and its comparison with the prediction."""
