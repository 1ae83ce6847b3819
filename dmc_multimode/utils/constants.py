"""Constants of more than one room."""

GRAVITY = 9.81  # m/s^2
CONTROL_TIMESTEP = 0.03  # Seconds between the actions of a policy.
PHYSICS_TIMESTEP = 0.005  # Seconds; trainings may take longer steps.
TRAINING_STEPS = 12_000_000  # Environment steps of a training, by default.
STAND_HEIGHT = 0.5  # Metres from the soles to the trunk's centre in the crouch.
# Farther than this from its reference, the trunk has lost it.
TRACKING_DISTANCE = 0.35  # Metres.
TRACKING_ANGLE = 1.0  # Radians.
