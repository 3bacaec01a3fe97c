//! What a pyramid and its features will take.

use super::NeighbourLimits;

/// Bytes of a number, an index.
const WORD: u64 = 4;

/// Rows of features of a stage that live at once: what comes in, the shortcut, what lies between, what goes out, and a
/// copy in the matrix product.
const LIVE: u64 = 5;

/// An estimate of the bytes that a pyramid with so many points in each stage (both clouds together) takes with the
/// features of a network, of which `channels` are the widest of each stage.
///
/// It is made from counts alone, before anything is allocated, so that clouds that would not fit can be refused.
#[must_use]
pub fn pyramid_bytes(counts: &[usize], limits: &NeighbourLimits, channels: &[usize]) -> u64 {
    let wide = |value: usize| value as u64;
    let stage = |(level, &count): (usize, &usize)| {
        let limit = wide(limits.0.get(level).copied().unwrap_or(0));
        let coarser = wide(counts.get(level + 1).copied().unwrap_or(0));
        let indices =
            wide(count).saturating_mul(limit + 4).saturating_add(coarser.saturating_mul(limit));
        let channels = wide(channels.get(level).copied().unwrap_or(0));
        let features = wide(count).saturating_mul(channels * LIVE);
        indices.saturating_add(features).saturating_mul(WORD)
    };
    let stages = counts.iter().enumerate().map(stage).fold(0, u64::saturating_add);
    // Not finer than a stage: what blocks of rows take while they are aggregated.
    stages.saturating_add(super::convolution::BLOCK_BYTES as u64 * 3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn estimates_grow_with_points_and_never_wrap() {
        let limits = NeighbourLimits::three_d_match();
        let bytes = |points| {
            pyramid_bytes(
                &[points, points / 3, points / 9, points / 27],
                &limits,
                &[128, 256, 512, 1024],
            )
        };
        assert!(bytes(30_000) < bytes(60_000) && bytes(30_000) < 1 << 30);
        assert!(bytes(10_000_000) > 20 << 30);
        assert_eq!(bytes(usize::MAX), u64::MAX);
    }
}
