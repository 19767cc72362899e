//! Large, empty memory: zeros from the system, which nothing touches before it is needed, in large pages where the system
//! has them. With small ones, buffers of a hundred megabytes that are hit at random spend their time on finding pages.

use std::sync::atomic::{AtomicU32, AtomicU64};

use rayon::prelude::*;

use crate::error::{Error, Result};

/// A value whose bits may all be zero.
///
/// # Safety
/// All bits zero has to be a valid value.
pub(crate) unsafe trait Zeroed {}
// SAFETY: all bits zero is the number 0.
unsafe impl Zeroed for AtomicU32 {}
// SAFETY: all bits zero is the number 0.
unsafe impl Zeroed for AtomicU64 {}
// SAFETY: all bits zero is the number 0.
unsafe impl Zeroed for u8 {}
// SAFETY: all bits zero is the number 0.
unsafe impl Zeroed for u16 {}
// SAFETY: all bits zero is the number 0.
unsafe impl Zeroed for f32 {}
// SAFETY: all bits zero is the number 0.
unsafe impl Zeroed for f64 {}
// SAFETY: all bits zero is the number 0.
unsafe impl Zeroed for i64 {}
// SAFETY: all bits zero is the number 0.
unsafe impl Zeroed for u32 {}
// SAFETY: an array is its elements side by side.
unsafe impl<T: Zeroed, const N: usize> Zeroed for [T; N] {}

/// `n` zeros that are about to be written over. As `vec![0; n]`, which the memory's end ends likewise, but in large pages:
/// what fresh memory costs is the finding of its pages, one by one.
pub(crate) fn fresh<T: Zeroed + Clone>(n: usize) -> Vec<T> {
    let Ok(layout) = std::alloc::Layout::array::<T>(n) else { std::process::abort() };
    if layout.size() == 0 {
        return Vec::new();
    }
    zeros(n, "").unwrap_or_else(|_| std::alloc::handle_alloc_error(layout))
}

/// `n` zeros for `what`; refused where there is no memory.
pub(crate) fn zeros<T: Zeroed>(n: usize, what: &str) -> Result<Vec<T>> {
    let refused = || Error::invalid(format!("there is no memory for {what} of {} MB", n * size_of::<T>() / 1_000_000));
    let layout = std::alloc::Layout::array::<T>(n).map_err(|_| refused())?;
    if layout.size() == 0 {
        return Ok(Vec::new());
    }
    // SAFETY: the layout is not empty; the memory is of the global allocator, of this layout, and zeros are valid.
    unsafe {
        let memory = std::alloc::alloc_zeroed(layout).cast::<T>();
        if memory.is_null() {
            return Err(refused());
        }
        prefer_large_pages(memory.cast(), layout.size());
        Ok(Vec::from_raw_parts(memory, n, n))
    }
}

/// `n` zeros for `what` that will all be used: their memory is fetched at once and by all processors. Where reading came
/// first, each page would be found twice.
pub(crate) fn fetched<T: Zeroed + Send>(n: usize, what: &str) -> Result<Vec<T>> {
    let mut memory = zeros::<T>(n, what)?;
    let page = (PAGE / size_of::<T>().max(1)).max(1);
    memory.par_chunks_mut(SHARE * page).for_each(|part| {
        for first in part.iter_mut().step_by(page) {
            // SAFETY: zeros over zeros, which are valid; volatile, as the compiler would see that nothing changes.
            unsafe { std::ptr::from_mut(first).cast::<u8>().write_volatile(0) };
        }
    });
    Ok(memory)
}

/// Bytes of a page, at least.
const PAGE: usize = 4096;
/// Pages that are fetched by one processor: a large one.
const SHARE: usize = 512;

/// Asks for large pages for untouched memory. Advice: if it is not taken, nothing is lost.
#[cfg(target_os = "linux")]
fn prefer_large_pages(memory: *mut u8, size: usize) {
    /// Below this there is nothing to win.
    const LARGE: usize = 4 << 20;
    if size >= LARGE {
        let before = memory.align_offset(PAGE);
        // SAFETY: the range lies within one allocation, and the advice changes none of its contents.
        unsafe { libc::madvise(memory.add(before).cast(), (size - before) / PAGE * PAGE, libc::MADV_HUGEPAGE) };
    }
}

#[cfg(not(target_os = "linux"))]
fn prefer_large_pages(_memory: *mut u8, _size: usize) {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gives_zeros_of_any_size_and_refuses_what_no_machine_has() {
        for n in [0, 1, 1000, 3 << 20] {
            let zeros = zeros::<f32>(n, "a test").unwrap();
            assert!(zeros.len() == n && zeros.iter().all(|&v| v == 0.0), "{n}");
            let fetched = fetched::<[u16; 3]>(n, "a test").unwrap();
            assert!(fetched.len() == n && fetched.as_flattened().iter().all(|&v| v == 0), "{n}");
        }
        let error = zeros::<AtomicU64>(1 << 55, "a test").unwrap_err().to_string();
        assert!(error.starts_with("there is no memory for a test of "), "{error}");
    }
}
