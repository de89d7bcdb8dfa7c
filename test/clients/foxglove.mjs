// SPDX-License-Identifier: BSD-3-Clause
// Runs one scenario with Foxglove's own client, @foxglove/ws-protocol, and its readers and writers of ROS messages:
//
//   node foxglove.mjs URL SUBPROTOCOL SCENARIO OPTIONS
//
// What comes of it goes out as a JSON line {"done": …}. Values that JSON lacks are written as objects with the key `$`.

import wsProtocol from '@foxglove/ws-protocol';
import { parse } from '@foxglove/rosmsg';
import { MessageReader, MessageWriter } from '@foxglove/rosmsg-serialization';
import WebSocket from 'ws';

const [url, subprotocol, scenario, options] = process.argv.slice(2);

// A client with what it was told, and promises of what is to come.
class Page {
  channels = new Map();
  services = new Map();
  statuses = [];
  #waiting = [];

  constructor() {
    this.client = new wsProtocol.FoxgloveClient({ ws: new WebSocket(url, [subprotocol]) });
    this.client.on('error', (error) => { throw error; });
    this.client.on('advertise', (channels) => channels.forEach((each) => this.channels.set(each.topic, each)));
    this.client.on('advertiseServices', (services) => services.forEach((each) => this.services.set(each.name, each)));
    this.client.on('status', (status) => this.statuses.push(status));
    this.info = this.next('serverInfo'); // what may come with it must not be missed either
    this.time = this.next('time');
    for (const event of ['advertise', 'advertiseServices', 'status']) this.client.on(event, () => this.#look());
  }

  #look() {
    this.#waiting = this.#waiting.filter((look) => !look());
  }

  // The value of a condition, once it has one.
  until(condition) {
    return new Promise((resolve) => {
      const look = () => {
        const found = condition();
        if (found !== undefined) resolve(found);
        return found !== undefined;
      };
      if (!look()) this.#waiting.push(look);
    });
  }

  channel(topic) {
    return this.until(() => this.channels.get(topic));
  }

  service(name) {
    return this.until(() => this.services.get(name));
  }

  // The next event of a kind that fulfils a condition.
  next(event, condition = () => true) {
    return new Promise((resolve) => {
      const take = (value) => {
        if (!condition(value)) return;
        this.client.off(event, take);
        resolve(value);
      };
      this.client.on(event, take);
    });
  }

  // The first message of a topic, decoded with what its channel says.
  async first(topic) {
    const channel = await this.channel(topic);
    if (channel.encoding !== 'ros1' || channel.schemaEncoding !== 'ros1msg') throw new Error(JSON.stringify(channel));
    const reader = new MessageReader(parse(channel.schema));
    const id = this.client.subscribe(channel.id);
    const { data } = await this.next('message', (message) => message.subscriptionId === id);
    this.client.unsubscribe(id);
    return reader.readMessage(data);
  }

  async call(name, request, encoding = 'ros1') {
    const service = await this.service(name);
    const callId = Math.floor(Math.random() * 2 ** 32);
    const data = encoding === 'json'
      ? new TextEncoder().encode(JSON.stringify(request))
      : new MessageWriter(parse(service.request.schema)).writeMessage(request);
    const answer = Promise.race([
      this.next('serviceCallResponse', (response) => response.callId === callId),
      this.next('serviceCallFailure', (failure) => failure.callId === callId),
    ]);
    this.client.sendServiceCallRequest({ serviceId: service.id, callId, encoding, data });
    const { data: response, message } = await answer;
    if (message !== undefined) return { failed: message };
    return encoding === 'json'
      ? JSON.parse(new TextDecoder().decode(response))
      : new MessageReader(parse(service.response.schema)).readMessage(response);
  }
}

const scenarios = {
  async info(page) {
    return page.info;
  },

  // The first message of each topic; each is published again, as read, on another topic.
  async topics(page, { topics, prefix }) {
    const decoded = await Promise.all(topics.map(async (topic) => [topic, await page.first(topic)]));
    for (const [topic, message] of decoded) {
      const { schemaName, schema } = page.channels.get(topic);
      const to = prefix + topic.split('/').at(-1);
      const id = page.client.advertise({ topic: to, encoding: 'ros1', schemaName, schema, schemaEncoding: 'ros1msg' });
      page.client.sendMessage(id, new MessageWriter(parse(schema)).writeMessage(message));
      page.client.unadvertise(id);
    }
    page.client.getParameters(['/rosdistro'], 'all before it is handled');
    await page.next('parameterValues');
    return { decoded: Object.fromEntries(decoded), statuses: page.statuses };
  },

  async services(page, { add, fail }) {
    return {
      ros1: await page.call(add, { a: 40n, b: 2n }),
      json: await page.call(add, { a: 1, b: 2 }, 'json'),
      failure: await page.call(fail, { a: 1n, b: 2n }),
    };
  },

  async parameters(page, { name }) {
    const { client } = page;
    const asked = (id) => page.next('parameterValues', (values) => values.id === id);
    const set = asked('set');
    const value = { name, value: [1, 2.5], type: 'float64_array' };
    client.setParameters([value], 'set');
    const outcome = { set: (await set).parameters };
    client.subscribeParameterUpdates([name]);
    const updated = page.next('parameterValues', (values) => values.id === undefined);
    client.setParameters([{ name, value: 'new' }]);
    outcome.updated = (await updated).parameters;
    const removed = page.next('parameterValues', (values) => values.id === undefined);
    client.setParameters([{ name, value: undefined }]);
    outcome.removed = (await removed).parameters;
    client.unsubscribeParameterUpdates([name]);
    const all = asked('all');
    client.getParameters([], 'all');
    outcome.all = (await all).parameters.map((parameter) => parameter.name);
    return outcome;
  },

  async graph(page) {
    const graph = page.next('connectionGraphUpdate');
    page.client.subscribeConnectionGraph();
    return graph;
  },

  async assets(page, { uris }) {
    const answers = uris.map((_, index) => page.next('fetchAssetResponse', ({ requestId }) => requestId === index));
    uris.forEach((uri, index) => page.client.fetchAsset(uri, index));
    return (await Promise.all(answers)).map(({ status, error, data }) => (
      { status, error, text: data && new TextDecoder().decode(data) }
    ));
  },

  async time(page) {
    return page.time;
  },

  async mistakes(page) {
    await page.channel('/rosout');
    page.client.subscribe(4294967295);
    return page.until(() => page.statuses[0]);
  },
};

function plain(key, value) {
  if (typeof value === 'number' && !Number.isFinite(value)) return { $: String(value) };
  if (typeof value === 'bigint') return Number(value);
  if (value instanceof Uint8Array) return { $: 'bytes', base64: Buffer.from(value).toString('base64') };
  if (ArrayBuffer.isView(value)) return Array.from(value);
  return value;
}

const page = new Page();
await page.info;
const done = await scenarios[scenario](page, JSON.parse(options));
process.stdout.write(JSON.stringify({ done }, plain) + '\n');
page.client.close();
process.exit(0);
