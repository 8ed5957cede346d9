"""Poses with contact: limbs sent by inverse kinematics to places on the body, to the floor, or into the air."""
