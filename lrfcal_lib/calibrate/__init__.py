"""The stages in order: observations, platform, cameras, joint estimate, coloured cloud."""
