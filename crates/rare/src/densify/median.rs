//! The 5 x 5 median by a sorting network.
//!
//! The columns of all windows of a row are sorted first: five windows share each of them. The median is then picked
//! out of the sorted columns by a network without a branch, which the compiler runs on several pixels at once.

use std::array::from_fn;

use super::image::Image;

/// Puts the smaller number of a pair of places into the first and the larger one into the second.
#[inline(always)]
fn compare_exchange<const N: usize>(values: &mut [f32; N], low: usize, high: usize) {
    let (a, b) = (values[low], values[high]);
    values[low] = if a < b { a } else { b };
    values[high] = if a < b { b } else { a };
}

/// Runs a network of [`compare_exchange`] written as pairs of places. A loop over a table of pairs would hide from the
/// compiler that the places are constants.
macro_rules! sorting_network {
    ($values:ident: $($low:literal $high:literal),* $(,)?) => {
        $(compare_exchange(&mut $values, $low, $high);)*
    };
}

/// Every pixel becomes the 13th of the 25 values around it; pixels outside repeat the edge.
pub fn median5(image: &mut Image) {
    let mut ranks: [Vec<f32>; 5] = from_fn(|_| vec![0.0; image.width() + 4]);
    image.rewrite_rows(|image, y, row| {
        let last = image.height() - 1;
        sort_columns(from_fn(|k| image.row((y + k).saturating_sub(2).min(last))), &mut ranks);
        let [a, b, c, d, e] = &ranks;
        let windows = a
            .array_windows()
            .zip(b.array_windows())
            .zip(c.array_windows())
            .zip(d.array_windows())
            .zip(e.array_windows());
        for (value, ((((a, b), c), d), e)) in row.iter_mut().zip(windows) {
            *value = median_of_sorted_columns([a, b, c, d, e]);
        }
    });
}

/// Sorts what stands above each other in five rows: `ranks[k]` holds the `k`-th smallest of every column, with the
/// outermost columns repeated twice on each side.
fn sort_columns(rows: [&[f32]; 5], ranks: &mut [Vec<f32>; 5]) {
    let width = rows[0].len();
    let [a, b, c, d, e] = ranks.each_mut().map(|rank| &mut rank[2..2 + width]);
    let sorted = a.iter_mut().zip(b).zip(c).zip(d).zip(e);
    let columns = rows[0].iter().zip(rows[1]).zip(rows[2]).zip(rows[3]).zip(rows[4]);
    for (((((a, b), c), d), e), ((((&p, &q), &r), &s), &t)) in sorted.zip(columns) {
        let mut v = [p, q, r, s, t];
        sorting_network!(v: 0 3, 1 4, 0 2, 1 3, 0 1, 2 4, 1 2, 3 4, 2 3);
        [*a, *b, *c, *d, *e] = v;
    }
    for rank in ranks {
        let (first, last) = (rank[2], rank[width + 1]);
        rank[..2].fill(first);
        rank[width + 2..].fill(last);
    }
}

/// The median of five columns, each sorted: `ranks[k][j]` is the `k`-th smallest of column `j`.
///
/// The first five lines sort along the rows, where twelve values turn out to be too small or too large; the other
/// lines find the middle of the remaining thirteen. The network is a pruned one: exchanges that no input needs (zeros
/// and ones are enough to tell, Knuth, The Art of Computer Programming 3, theorem 5.3.4.Z) were left out.
#[inline(always)]
fn median_of_sorted_columns(ranks: [&[f32; 5]; 5]) -> f32 {
    let mut v: [f32; 25] = from_fn(|i| ranks[i / 5][i % 5]);
    sorting_network!(v:
        1 4, 0 2, 0 1, 2 4, 1 2, 3 4, 2 3,
        5 8, 5 7, 6 8, 5 6, 7 9, 6 7, 8 9, 7 8,
        10 13, 11 14, 10 12, 11 13, 10 11, 12 14, 11 12, 13 14, 12 13,
        15 18, 16 19, 15 17, 16 18, 15 16, 17 19, 16 17, 17 18,
        20 23, 21 24, 20 22, 21 23, 20 21, 22 24, 21 22,
        7 15, 3 11, 4 8, 20 12, 15 11, 4 20, 8 12, 16 13, 17 21,
        8 20, 16 9, 11 8, 8 20, 8 17, 11 8, 20 16, 8 20,
    );
    v[20]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_network_is_right_for_all_sorted_columns_of_zeros_and_ones() {
        for case in 0..6_usize.pow(5) {
            let ones: [usize; 5] = from_fn(|column| case / 6_usize.pow(column as u32) % 6);
            let ranks: [[f32; 5]; 5] =
                from_fn(|rank| from_fn(|column| f32::from(u8::from(rank + ones[column] >= 5))));
            let expected = f32::from(u8::from(ones.iter().sum::<usize>() >= 13));
            assert_eq!(median_of_sorted_columns(ranks.each_ref()), expected, "{ones:?}");
        }
    }
}
