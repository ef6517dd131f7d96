"""The whole experiment as stages: capture, scene, policy, object, attack, deploy, report. Wires parts together, decides nothing."""
