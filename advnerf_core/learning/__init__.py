"""How a driving policy is trained: frames, augmentation, imitation, retraining."""
