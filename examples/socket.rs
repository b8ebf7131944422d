//! Decodes a stream while it arrives over a TCP connection, and draws each level as soon as it is complete.
//!
//!     cargo run --release --example socket -- models/scene.b2p
//!
//! The sender is a thread of this program, on 127.0.0.1; the receiver makes no use of that.

use std::error::Error;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::time::Duration;
use std::{fs, thread};

use b2p::{Camera, Decoder, Renderer};

fn main() -> Result<(), Box<dyn Error>> {
    let input = std::env::args().nth(1).ok_or("usage: socket STREAM.b2p")?;
    let bytes = fs::read(input)?;
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let address = listener.local_addr()?;
    let sender = thread::spawn(move || send(&listener, &bytes));
    receive(TcpStream::connect(address)?)?;
    sender.join().map_err(|_| "the sender panicked")??;
    Ok(())
}

/// Sends the stream in packets, slowly.
fn send(listener: &TcpListener, bytes: &[u8]) -> std::io::Result<()> {
    let (mut connection, _) = listener.accept()?;
    for packet in bytes.chunks(1400) {
        connection.write_all(packet)?;
        thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}

/// Decodes and draws what arrives. A connection that breaks leaves the levels that were complete.
fn receive(mut connection: TcpStream) -> Result<(), Box<dyn Error>> {
    let camera = Camera::orbit(20.0, 20.0, 2.6, 45.0, 640, 480)?;
    let mut renderer = Renderer::new();
    let mut decoding = Decoder::new().start();
    let mut buffer = [0; 4096];
    let mut received = 0;
    loop {
        let count = connection.read(&mut buffer)?;
        if count == 0 {
            break;
        }
        received += count;
        decoding.push(&buffer[..count]);
        while let Some(level) = decoding.advance()? {
            if !decoding.is_drawable() {
                continue;
            }
            let gaussians = decoding.gaussians()?;
            let path = std::env::temp_dir().join(format!("level-{level}.png"));
            fs::write(&path, renderer.render(&gaussians, &camera)?.to_png()?)?;
            println!(
                "after {received} bytes, {}: {} Gaussians",
                path.display(),
                gaussians.len()
            );
        }
    }
    decoding.finish()?;
    Ok(())
}
