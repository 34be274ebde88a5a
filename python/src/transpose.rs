//! Rows of instances to rows of lanes, and back.
//!
//! In: numbers of one column, those of an instance one after the other. Out: rows with the number of each lane. Blocks
//! of two lanes by two rows are transposed in registers (`unpcklpd`, `unpckhpd`); one number at a time, a transfer takes
//! 0.3 ns more.

/// The first numbers of two pairs, and the second ones.
#[inline(always)]
fn pairs(a: [f64; 2], b: [f64; 2]) -> ([f64; 2], [f64; 2]) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_mm_loadu_pd, _mm_storeu_pd, _mm_unpackhi_pd, _mm_unpacklo_pd};
        let (mut low, mut high) = ([0.0; 2], [0.0; 2]);
        // SAFETY: every x86-64 processor has SSE2; each array has two numbers.
        unsafe {
            let (a, b) = (_mm_loadu_pd(a.as_ptr()), _mm_loadu_pd(b.as_ptr()));
            _mm_storeu_pd(low.as_mut_ptr(), _mm_unpacklo_pd(a, b));
            _mm_storeu_pd(high.as_mut_ptr(), _mm_unpackhi_pd(a, b));
        }
        (low, high)
    }
    #[cfg(not(target_arch = "x86_64"))]
    ([a[0], b[0]], [a[1], b[1]])
}

/// Writes the rows of all lanes. `of`: the numbers of a lane, as many as there are rows.
pub fn to_lanes<'a>(of: impl Fn(usize) -> &'a [f64], tile: &mut [f64], width: usize) {
    let even = width & !1;
    for lane in (0..even).step_by(2) {
        let ((a, last_a), (b, last_b)) = (of(lane).as_chunks::<2>(), of(lane + 1).as_chunks::<2>());
        let mut two = tile.chunks_exact_mut(2 * width);
        for ((rows, a), b) in (&mut two).zip(a).zip(b) {
            let (top, bottom) = rows.split_at_mut(width);
            let (first, second) = pairs(*a, *b);
            top[lane..][..2].copy_from_slice(&first);
            bottom[lane..][..2].copy_from_slice(&second);
        }
        if let ([a], [b]) = (last_a, last_b) {
            two.into_remainder()[lane..][..2].copy_from_slice(&[*a, *b]);
        }
    }
    for lane in even..width {
        tile.chunks_exact_mut(width).zip(of(lane)).for_each(|(row, x)| row[lane] = *x);
    }
}

/// Reads the rows of the first `used` lanes. The numbers of a lane begin `stride` after those of the one before.
pub fn from_lanes(tile: &[f64], width: usize, to: &mut [f64], stride: usize, used: usize) {
    let rows = tile.len() / width;
    let even = used & !1;
    for lane in (0..even).step_by(2) {
        let (a, b) = to[lane * stride..].split_at_mut(stride);
        let ((a, last_a), (b, last_b)) = (a[..rows].as_chunks_mut::<2>(), b[..rows].as_chunks_mut::<2>());
        let two = tile.chunks_exact(2 * width);
        let last = two.remainder();
        for ((rows, a), b) in two.zip(a).zip(b) {
            let (top, bottom) = rows.split_at(width);
            (*a, *b) = pairs([top[lane], top[lane + 1]], [bottom[lane], bottom[lane + 1]]);
        }
        if let ([a], [b]) = (last_a, last_b) {
            (*a, *b) = (last[lane], last[lane + 1]);
        }
    }
    for lane in even..used {
        to[lane * stride..].iter_mut().zip(tile.chunks_exact(width)).for_each(|(x, row)| *x = row[lane]);
    }
}
