"""Training of a driving policy: frames, augmentation, imitation, retraining."""
