"""Training of the models that ship: one package a model."""
