"""What the machines do: the physics twin beside the kinematics, and the shield."""
