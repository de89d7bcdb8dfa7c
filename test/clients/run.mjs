// SPDX-License-Identifier: BSD-3-Clause
// Runs one scenario with one line of roslib, as a program of its own:
//
//   node run.mjs LINE URL FILE SCENARIO OPTIONS
//
// LINE is 1 or 2, SCENARIO a function that FILE exports, OPTIONS a JSON object. The same scenario runs with both lines;
// it gets a `Page` and the options. What it has to say goes out as JSON lines, as the ROS nodes of the tests do it:
// whatever it `say`s, {"status": …} for each status message that the bridge sends, and at last {"done": its result}.
// A scenario that waits for the test goes on with SIGUSR2. The exit code is 0 only when it got to its end. Values that JSON lacks are written as objects with the key `$`.

import { EventEmitter } from 'node:events';

import { once } from './wait.mjs';

const [line, url, file, scenario, options] = process.argv.slice(2);
const module = await import(`roslib${line}`);
const roslib = module.default ?? module;

const signals = new EventEmitter();
let pending = 0;
process.on('SIGUSR2', () => {
  pending += 1;
  signals.emit('signal');
});

class Page {
  line = Number(line);
  roslib = roslib;
  url = url;
  #connections = [];
  #hearing = new Set();

  say(record) {
    process.stdout.write(JSON.stringify(record, plain) + '\n');
  }

  // A new connection, once it is open.
  async connect(target = url) {
    const ros = new roslib.Ros({ url: target });
    this.#connections.push(ros);
    const emit = ros.emit;
    ros.emit = (name, ...values) => {
      if (/^status(:|$)/.test(name)) {
        this.say({ status: values[0] });
        this.#hearing.forEach((hear) => hear(values[0], ros));
      }
      return emit.call(ros, name, ...values);
    };
    await new Promise((resolve, reject) => {
      ros.once('connection', resolve);
      ros.on('error', (error) => reject(new Error(`no connection to ${target}: ${error.message}`)));
    });
    return ros;
  }

  // What `subscribe` returns, once the so many subscriptions that it makes are live: the bridge confirms each one.
  async live(ros, count, subscribe) {
    ros.setStatusLevel('info', 'level');
    let hear;
    const confirmed = new Promise((resolve) => {
      hear = (status, from) => {
        if (from === ros && status.level === 'info' && /^subscribe:/.test(status.id)) count -= 1;
        if (count === 0) resolve();
      };
    });
    this.#hearing.add(hear);
    const result = subscribe();
    await confirmed;
    this.#hearing.delete(hear);
    ros.setStatusLevel('error', 'level');
    return result;
  }

  // Until the test says so.
  async told() {
    if (pending === 0) await once(signals, 'signal');
    pending -= 1;
  }

  async closeAll() {
    const open = this.#connections.filter((ros) => ros.isConnected);
    await Promise.all(open.map((ros) => {
      const closed = once(ros, 'close');
      ros.close();
      return closed;
    }));
  }

  message(values) {
    return roslib.Message ? new roslib.Message(values) : values;
  }

  // The response of a call, or {failed: the reason}.
  call(ros, name, serviceType, values = {}, ...more) {
    const service = new roslib.Service({ ros, name, serviceType });
    const request = roslib.ServiceRequest ? new roslib.ServiceRequest(values) : values;
    return new Promise((resolve) => {
      service.callService(request, resolve, (reason) => resolve({ failed: reason }), ...more);
    });
  }
}

function plain(key, value) {
  if (typeof value === 'number' && !Number.isFinite(value)) return { $: String(value) };
  if (typeof value === 'bigint') return { $: 'BigInt', value: String(value) };
  if (value instanceof Uint8Array) return { $: 'Uint8Array', base64: Buffer.from(value).toString('base64') };
  if (ArrayBuffer.isView(value)) return { $: value.constructor.name, values: Array.from(value) };
  return value;
}

const page = new Page();
try {
  const scenarios = await import(file);
  const result = await scenarios[scenario](page, JSON.parse(options));
  await page.closeAll();
  page.say({ done: result ?? null });
  process.exit(0); // roslib's action servers never stop their timers
} catch (error) {
  console.error(error);
  process.exit(1);
}
