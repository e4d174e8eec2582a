"""What a shape of planes, cylinders and spheres lets one know where points are noisy, few or missing."""
