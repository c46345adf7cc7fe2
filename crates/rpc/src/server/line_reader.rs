//! Reads lines of bounded length.

use tokio::io::{AsyncBufRead, AsyncBufReadExt};

/// Result of reading a line.
pub(crate) enum Line {
    /// The buffer has a line with its newline.
    Complete,
    /// The connection has ended. Bytes after the last newline are ignored.
    End,
    /// The line exceeds the maximum length.
    TooLong,
}

/// Appends to `line` until its newline, at most `max` bytes. May be cancelled and called again: what was read so far
/// stays in `line`.
pub(crate) async fn read_line(from: &mut (impl AsyncBufRead + Unpin), line: &mut Vec<u8>, max: usize) -> Line {
    loop {
        let chunk = match from.fill_buf().await {
            Ok([]) | Err(_) => return Line::End,
            Ok(chunk) => chunk,
        };
        let (take, complete) = match chunk.iter().position(|b| *b == b'\n') {
            Some(at) => (at + 1, true),
            None => (chunk.len(), false),
        };
        if line.len() + take > max {
            return Line::TooLong;
        }
        line.extend(chunk.iter().take(take));
        from.consume(take);
        if complete {
            return Line::Complete;
        }
    }
}

/// Discards the rest of a line, so that its sender can read why the line was refused.
pub(crate) async fn skip_line(from: &mut (impl AsyncBufRead + Unpin)) {
    loop {
        let chunk = match from.fill_buf().await {
            Ok([]) | Err(_) => return,
            Ok(chunk) => chunk,
        };
        let end = chunk.iter().position(|b| *b == b'\n');
        let take = end.map_or(chunk.len(), |at| at + 1);
        from.consume(take);
        if end.is_some() {
            return;
        }
    }
}
