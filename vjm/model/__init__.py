"""The arm: its rigid-body dynamics, natural modes, torque errors and URDF."""
