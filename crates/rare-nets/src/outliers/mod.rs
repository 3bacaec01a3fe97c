//! Networks that tell right correspondences from wrong ones.
