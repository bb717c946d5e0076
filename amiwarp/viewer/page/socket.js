// Connection to the server. trame's client reads each message as a Blob, which browsers keep in another process: reading
// 1 MB back takes longer than drawing it. This socket keeps messages in memory, and looks like trame's.

class MemoryMessage {
  constructor(bytes) {
    this.bytes = bytes;
  }

  slice(start, stop) {
    return new MemoryMessage(this.bytes.subarray(start, stop));
  }

  async arrayBuffer() {
    return this.bytes;
  }
}

class MemorySocket extends WebSocket {
  set binaryType(_) {
    super.binaryType = 'arraybuffer';
  }

  set onmessage(call) {
    super.onmessage = ({ data }) => call({ data: new MemoryMessage(new Uint8Array(data)) });
  }
}

// trame's client takes the socket from here if the address says so. It then asks for no launcher of servers first.
window.WSLINK = {
  createWebSocket() {
    const address = new URL('ws', document.baseURI);
    address.protocol = address.protocol.replace('http', 'ws');
    return new MemorySocket(address);
  },
};
window.history.replaceState(null, '', `?wsProxy=true&remove=wsProxy${window.location.hash}`);
