"""From calibrated views to one canonical face frame: 2D landmarks, triangulation, keypoints, template, similarity."""
