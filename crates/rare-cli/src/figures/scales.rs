//! Round numbers on scales: ticks of axes and colour bars, lengths of scale bars.

/// The largest step of 1, 2 or 5 times a power of ten that divides a span into at least `parts`; `None` if the span is
/// not a length.
pub(super) fn round_step(span: f64, parts: f64) -> Option<f64> {
    let most = span / parts;
    if !(most.is_finite() && most > f64::MIN_POSITIVE) {
        return None;
    }
    let decade = 10f64.powf(most.log10().floor());
    // A hair of slack, since powers of ten are not exact.
    [5.0, 2.0, 1.0].map(|digit| digit * decade).into_iter().find(|&step| step <= most * 1.000_001)
}

/// Round values from `low` to `high`, as text: between `parts` and some 2.5 times as many.
pub(super) fn ticks(low: f64, high: f64, parts: f64) -> Vec<(f64, String)> {
    let Some(step) = round_step(high - low, parts) else { return Vec::new() };
    let first = (low / step - 1e-6).ceil();
    let last = (high / step + 1e-6).floor();
    // Far from 0 a step may be less than what a number can tell apart.
    if !(last - first).is_finite() || last - first > 4.0 * parts.max(1.0) {
        return Vec::new();
    }
    let count = (last - first) as usize;
    let value = |index: usize| (first + index as f64) * step;
    (0..=count).map(|index| (value(index), in_steps(value(index), step))).collect()
}

/// A value with as many decimals as its step needs.
pub(super) fn in_steps(value: f64, step: f64) -> String {
    let decimals = (-(step.log10() + 1e-6).floor()).clamp(0.0, 9.0) as usize;
    if value.abs() < step / 2.0 { "0".to_owned() } else { format!("{value:.decimals$}") }
}

/// A length in metres as people say it.
pub(super) fn length(metres: f64) -> String {
    match metres {
        metres if !metres.is_finite() => "unknown".to_owned(),
        metres if metres >= 10.0 => format!("{metres:.0} m"),
        metres if metres >= 1.0 => format!("{metres:.1} m"),
        metres if metres >= 0.1 => format!("{:.0} cm", 100.0 * metres),
        metres if metres >= 0.01 => format!("{:.1} cm", 100.0 * metres),
        metres => format!("{:.2} mm", 1000.0 * metres),
    }
}

/// A round length in metres, as it stands beside a scale bar.
pub(super) fn round_length(metres: f64) -> String {
    let (value, unit) = match metres {
        metres if metres >= 1.0 => (metres, "m"),
        metres if metres >= 0.01 => (100.0 * metres, "cm"),
        metres => (1000.0 * metres, "mm"),
    };
    // Nobody counts the zeros of more.
    if value >= 1e6 {
        format!("{value:e} {unit}")
    } else {
        format!("{} {unit}", in_steps(value, value.min(1.0)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        let texts = |low, high| ticks(low, high, 4.0).into_iter().map(|(_, text)| text);
        assert!(texts(0.0, 1.0).eq(["0", "0.2", "0.4", "0.6", "0.8", "1.0"]));
        assert!(texts(0.93, 3.1).eq(["1.0", "1.5", "2.0", "2.5", "3.0"]));
        assert!(texts(-20.0, 20.0).eq(["-20", "-10", "0", "10", "20"]));
        assert!(texts(0.0, 0.002).eq(["0", "0.0005", "0.0010", "0.0015", "0.0020"]));
    }

    #[test]
    fn spans_that_are_none_have_no_ticks() {
        let odd = [(0.0, 0.0), (1.0, 0.0), (0.0, f64::INFINITY), (f64::NAN, 1.0), (1e300, 1e300)];
        for (low, high) in odd {
            assert!(ticks(low, high, 4.0).is_empty(), "{low} to {high}");
        }
        assert!(ticks(1e17, 1e17 + 16.0, 4.0).len() < 20);
        assert!(ticks(-1e308, 1e308, 4.0).is_empty());
    }

    #[test]
    fn lengths_have_the_unit_that_suits_them() {
        let said = [83.4, 2.0, 0.304, 0.0123, 0.0004, f64::INFINITY].map(length);
        assert_eq!(said, ["83 m", "2.0 m", "30 cm", "1.2 cm", "0.40 mm", "unknown"]);
        let said = [2e9, 1000.0, 5.0, 0.5, 0.02, 0.005, 0.0002].map(round_length);
        assert_eq!(said, ["2e9 m", "1000 m", "5 m", "50 cm", "2 cm", "5 mm", "0.2 mm"]);
    }
}
