"""The boxes of the design: each joins what travels (`schemas`) to what computes (`ldo_service`)."""
