//! Rows of numbers in an array, such as the inputs of successive steps.

/// Rows of numbers, from the first column that counts.
#[derive(Clone, Copy, Debug)]
pub struct Rows<'a> {
    /// The numbers, SI.
    pub numbers: &'a [f64],
    /// Distance of two rows. 0: one row for all steps.
    pub stride: usize,
}

/// Rows of numbers to write.
#[derive(Debug)]
pub struct RowsMut<'a> {
    /// The numbers, SI.
    pub numbers: &'a mut [f64],
    /// Distance of two rows, at least the number of columns.
    pub stride: usize,
}
